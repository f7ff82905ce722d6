"""The commands of ``mjx-tt``, one typed function each.

Their modules import what is heavy inside the functions that need it, so that help and refusals come at once.
"""
