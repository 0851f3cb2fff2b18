"""What estimators of every domain share: rotations, Kalman filters, compilation."""
