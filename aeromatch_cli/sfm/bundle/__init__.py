"""Bundle adjustment with self-calibration: arrays in, arrays out."""
