"""``python -m giril_rl`` is the command ``giril``."""

import sys

from giril_rl.cli.command_line import main

if __name__ == "__main__":
    sys.exit(main())
