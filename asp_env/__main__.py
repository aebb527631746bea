"""`python -m asp_env COMMAND …` is `asp-env COMMAND …`."""

import sys

from asp_env.cli import main

if __name__ == "__main__":
    sys.exit(main())
