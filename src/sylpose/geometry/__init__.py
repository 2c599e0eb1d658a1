"""Building blocks of the estimators: array types, compiled linear algebra, robust statistics, validation."""
