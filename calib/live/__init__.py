"""`calib live`: a camera calibrated while one holds the board, led to the picture that helps most."""
