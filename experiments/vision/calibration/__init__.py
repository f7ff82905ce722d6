"""Cameras calibrated by what they see anyway: the table's lines, then balls that fly."""
