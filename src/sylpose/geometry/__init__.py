"""What the estimators are built from: array types, compiled linear algebra, small matrices, robust statistics."""
