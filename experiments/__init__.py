"""One short script for each reported result; run them as `python -m experiments.<name>`."""
