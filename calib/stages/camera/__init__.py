"""From corners of a checkerboard to a camera with error bars, and the homography of a plane."""
