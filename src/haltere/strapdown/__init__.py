"""State layouts, the mechanisation and the covariance propagation, as kernels. It takes no measurement: that is done in aids."""
