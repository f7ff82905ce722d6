"""Measurements by the command line; each module's ``main`` is a command, its docstring says what is measured."""
