"""Planning problems: drawn, labelled and kept on disk."""
