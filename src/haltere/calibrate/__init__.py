"""Calibration of sensors from their own log: the magnetometer. It corrects no flight; `haltere.flight.corrections` does."""
