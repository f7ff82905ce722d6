"""One session that keeps itself right: notice a change, say what it is, learn it, and play on."""
