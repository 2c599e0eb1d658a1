"""What the estimators are built from."""
