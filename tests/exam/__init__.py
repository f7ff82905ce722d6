"""Hidden effects in data, and whether the diagnosis finds them."""
