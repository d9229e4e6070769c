"""Run the command line by ``python -m streetgen``."""

import sys

from streetgen.cli import main

if __name__ == "__main__":
    sys.exit(main())
