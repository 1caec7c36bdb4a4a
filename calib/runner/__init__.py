"""A whole calibration: the verbs as stages, what each depends on, and what need not be done again."""
