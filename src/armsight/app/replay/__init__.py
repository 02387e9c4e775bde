"""``armsight replay``: measuring and the estimators again, on what was recorded."""
