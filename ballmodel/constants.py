"""Sizes and measured values of table, net and ball, each with its source. SI units.

Frame: origin at the table's centre on its top surface; x across, y along the table (human y > 0, robot y < 0), z up.
"""

from __future__ import annotations

GRAVITY = 9.81  # [m/s^2], Abeyruwan et al. 2022, appendix "Details on Modeling Human Ball Distributions"

# ITTF laws 2.1-2.3 and technical leaflets T1 (table), T2 (net), T3 (ball)
TABLE_LENGTH = 2.74  # [m] along y
TABLE_WIDTH = 1.525  # [m] along x
TABLE_HEIGHT = 0.76  # [m] above the floor
TABLE_THICKNESS = 0.03  # [m] of the top, estimate (25-30 mm are common)
NET_HEIGHT = 0.1525  # [m]
NET_OVERHANG = 0.1525  # [m] beyond each side of the table
NET_THICKNESS = 0.005  # [m], estimate for the tape
BALL_RADIUS = 0.020  # [m]
BALL_DIAMETER = 2 * BALL_RADIUS
BALL_MASS = 0.0027  # [kg]

# The paper's drag-only ball (same appendix). Its area is pi r^2 cut to four digits; its density is that of air at 0
# degC.
DRAG_COEFFICIENT = 0.47
AIR_DENSITY = 1.29  # [kg/m^3]
BALL_AREA = 1.256e-3  # [m^2]

# A table tennis ball is a thin shell: I = 2/3 m r^2.
SHELL_INERTIA_FACTOR = 2.0 / 3.0

# Nakashima et al.'s table contact, with the numbers used in code of the MPI table tennis group
TABLE_RESTITUTION = 0.93
TABLE_FRICTION = 0.25

# Rubber "inverted, offensive" of github.com/gossardt/tt_rackets, about 8,200 measured bounces
RUBBER_RESTITUTION = 0.917
RUBBER_RESTITUTION_SLOPE = 0.0217  # [s/m]
RUBBER_TANGENTIAL_GAIN = 0.68

PADDLE_RADIUS = 0.076  # [m], a disc of the blade's area (blade 0.17 x 0.15 m)
PADDLE_THICKNESS = 0.012  # [m], blade and two rubbers, estimate
