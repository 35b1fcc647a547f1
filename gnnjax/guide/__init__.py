"""What prices motions without checking them."""
