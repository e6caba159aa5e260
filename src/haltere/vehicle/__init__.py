"""What a multirotor's rotors and body do to it, for kernels. It reads no file and knows no estimator."""
