"""`python -m calib`: the command line, where the console script is not on the path."""

from calib.cli.main import main

main()
