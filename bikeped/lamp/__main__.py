"""`python -m bikeped.lamp LAMP_JSON`: the lamp's process."""

import sys

from bikeped.lamp.process import main

if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
