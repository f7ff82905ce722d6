"""Is the world still the one that is believed? Scores of single balls, and a test that runs along with play."""
