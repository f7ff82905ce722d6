"""All parameters at once, each with its prior: what to train on, where ``diagnose`` says what to repair."""
