"""One short script for each reported result; run them as `python -m experiments.<name>`."""

import gnnjax.interruption  # noqa: F401  as in gnnjax itself
