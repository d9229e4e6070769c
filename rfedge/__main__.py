"""``python -m rfedge``: the ``rfedge`` command."""

import sys

from rfedge.cli import main

if __name__ == "__main__":
    sys.exit(main())
