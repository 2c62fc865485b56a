"""The criterion J, its normal equations and their covariances."""
