"""What a solution is worth: errors against a reference, NIS and NEES. It runs no estimator and draws nothing."""
