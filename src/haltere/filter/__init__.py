"""What any Kalman filter needs: updates, innovation tests and queues by valid time, as kernels. It knows no drone and no sensor."""
