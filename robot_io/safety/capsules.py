"""The loops under ``clearance``: places of capsules, distances, and the proof that a way between two points is clear.

The gate asks for thousands of distances in each control period, so these are machine code, which numba compiles at the
first call and keeps on the disk. Arrays are float64.

    chain   transforms of the joints (n, 4, 4, 4) and of the robot's base (4, 4); of every capsule its joint, n for the
            base, and its ends in the joint's frame (2, 3)
    watch   capsules that are watched, pairs (two arrays), radii, corners (2, 3) of a box, height of the floor
    bounds  (n,) 1 for a hinge, 0 for a slide; (capsules, n) levers of the hinges [m]
"""

import math

import numpy as np
from numba import njit

TINY = 1e-12  # as in the simulation: segments more parallel than this are taken as parallel
NO_WAY = 1e-30  # a direction component that small is none

machine_code = njit(cache=True, error_model="numpy")


@machine_code
def place_frames(q, basis, base):
    """Transforms (B, n + 1, 4, 4) to the world from every joint's frame, and from the base's, at q (n, B)."""
    n, count = q.shape
    world = np.empty((count, n + 1, 4, 4))
    local = np.empty((4, 4))
    for b in range(count):
        world[b, n] = base
        for i in range(n):
            before = world[b, i - 1]  # at the first joint the last: the base
            sine, versine = math.sin(q[i, b]), 1.0 - math.cos(q[i, b])
            for r in range(4):
                for c in range(4):
                    local[r, c] = basis[i, 0, r, c] + sine * basis[i, 1, r, c] + versine * basis[i, 2, r, c]
                    local[r, c] += q[i, b] * basis[i, 3, r, c]
            for r in range(4):
                for c in range(4):
                    world[b, i, r, c] = before[r, 0] * local[0, c] + before[r, 1] * local[1, c]
                    world[b, i, r, c] += before[r, 2] * local[2, c] + before[r, 3] * local[3, c]
    return world


@machine_code
def place_ends(q, basis, base, joint, local):
    """World end points (B, capsules, 2, 3) of capsules on joints, whose ends in the joints' frames are ``local``."""
    world = place_frames(q, basis, base)
    found = np.empty((q.shape[1], len(joint), 2, 3))
    for b in range(len(found)):
        for c in range(len(joint)):
            frame = world[b, joint[c]]
            for end in range(2):
                x, y, z = local[c, end]
                for r in range(3):
                    found[b, c, end, r] = frame[r, 0] * x + frame[r, 1] * y + frame[r, 2] * z + frame[r, 3]
    return found


@machine_code
def box_distance(low, high, p, q):
    """Distance [m] of a segment p-q, ends (3,), and an axis-aligned box; 0 where they meet. Exact.

    The simulation's ``mjx_tt.robot.clearance.segment_box_distance`` bisects instead; a test compares the two.

    Along a segment the squared distance is convex and its derivative linear between the points where a coordinate
    enters or leaves its slab: interpolating between the two such points around the zero finds the minimum.
    """
    t_low, s_low, t_high, s_high = 0.0, -np.inf, 1.0, np.inf
    for kink in range(8):
        if kink < 2:
            t = float(kink)
        else:
            axis = kink % 3
            d = q[axis] - p[axis]
            if abs(d) < NO_WAY:
                continue
            t = ((low[axis] if kink < 5 else high[axis]) - p[axis]) / d
            if not 0.0 < t < 1.0:
                continue
        slope = 0.0
        for x in range(3):
            d = q[x] - p[x]
            at = p[x] + t * d
            slope += (at - min(max(at, low[x]), high[x])) * d
        if slope <= 0.0:
            t_low, s_low = max(t_low, t), max(s_low, slope)
        else:
            t_high, s_high = min(t_high, t), min(s_high, slope)
    best = 0.0
    if s_low > -np.inf:
        best = t_low - s_low / (s_high - s_low) * (t_high - t_low) if s_high < np.inf else 1.0
    square = 0.0
    for x in range(3):
        at = p[x] + best * (q[x] - p[x])
        square += (at - min(max(at, low[x]), high[x])) ** 2
    return math.sqrt(square)


@machine_code
def segment_distance(p1, q1, p2, q2):
    """Distance [m] of segments p1-q1 and p2-q2, each end (3,). Ericson, Real-Time Collision Detection, 2005, 5.1.9."""
    a = e = b = f = c = 0.0
    for x in range(3):
        d1, d2, r = q1[x] - p1[x], q2[x] - p2[x], p1[x] - p2[x]
        a, e, b, f, c = a + d1 * d1, e + d2 * d2, b + d1 * d2, f + d2 * r, c + d1 * r
    denominator = a * e - b * b
    s = (b * f - c * e) / denominator if denominator > TINY else 0.0
    t = min(max((b * min(max(s, 0.0), 1.0) + f) / max(e, TINY), 0.0), 1.0)
    s = min(max((b * t - c) / max(a, TINY), 0.0), 1.0)
    square = 0.0
    for x in range(3):
        square += (p1[x] - p2[x] + s * (q1[x] - p1[x]) - t * (q2[x] - p2[x])) ** 2
    return math.sqrt(square)


@machine_code
def measure_gaps(ends, watched, first, second, radius, block, floor):
    """Gaps (R,) [m] of one pose's capsules, ends (capsules, 2, 3): to the block (2, 3), of pairs, to the floor."""
    count, pairs = len(watched), len(first)
    gaps = np.empty(2 * count + pairs)
    for i in range(count):
        c = watched[i]
        gaps[i] = box_distance(block[0], block[1], ends[c, 0], ends[c, 1]) - radius[c]
        gaps[count + pairs + i] = min(ends[c, 0, 2], ends[c, 1, 2]) - radius[c] - floor
    for i in range(pairs):
        a, b = first[i], second[i]
        distance = segment_distance(ends[a, 0], ends[a, 1], ends[b, 0], ends[b, 1])
        gaps[count + i] = distance - radius[a] - radius[b]
    return gaps


@machine_code
def measure_all(ends, watch):
    """Gaps (R, B) [m] of the capsules in every pose, ends (B, capsules, 2, 3)."""
    gaps = np.empty((2 * len(watch[0]) + len(watch[1]), len(ends)))
    for b in range(len(ends)):
        gaps[:, b] = measure_gaps(ends[b], *watch)
    return gaps


@machine_code
def bound_bulges(dq, hinge, levers):
    """Bounds (capsules,) of how far any of a capsule's points leaves its chord while joints move straight by dq."""
    bulge, inner = np.zeros(len(levers)), 0.0
    for i in range(len(dq)):
        size = abs(dq[i]) * hinge[i]
        for c in range(len(levers)):
            bulge[c] += levers[c, i] * (size * (size + 2.0 * inner) / 8.0)
        inner += size
    return bulge


@machine_code
def _below(gaps, least):
    """The first row whose gap is less than its least one, or no number; -1: none."""
    for row in range(len(gaps)):
        if not gaps[row] >= least[row]:
            return row
    return -1


@machine_code
def _unclear(e0, e1, g0, g1, bulge, least, watched, first, second):
    """The first row that a stretch from ends e0 to e1, with gaps g0 and g1, may bring below its least gap; -1: none."""
    count, pairs = len(watched), len(first)
    for i in range(count):
        c, square = watched[i], 0.0
        for end in range(2):
            own = 0.0
            for x in range(3):
                own += (e1[c, end, x] - e0[c, end, x]) ** 2
            square = max(square, own)
        for row in (i, count + pairs + i):
            if not 0.5 * (g0[row] + g1[row] - math.sqrt(square)) - bulge[c] >= least[row]:
                return row
    for i in range(pairs):
        a, b, square = first[i], second[i], 0.0
        for k in range(2):
            for m in range(2):
                relative = 0.0
                for x in range(3):
                    relative += (e1[a, k, x] - e0[a, k, x] - e1[b, m, x] + e0[b, m, x]) ** 2
                square = max(square, relative)
        row = count + i
        if not 0.5 * (g0[row] + g1[row] - math.sqrt(square)) - bulge[a] - bulge[b] >= least[row]:
            return row
    return -1


@machine_code
def find_too_close(q, margin, slack, levels, chain, watch, bounds):
    """As of ``RobotGeometry.first_too_close``, -1 for None; ``chain``, ``watch`` and ``bounds`` as it holds them."""
    ends = place_ends(q, *chain)
    # The stretches that are still to be looked at: where they end, the nearest last, and how often they were halved.
    at, depth = np.empty((levels + 2, len(q))), np.zeros(levels + 2, np.int64)
    places, gaps = np.empty((levels + 2, *ends.shape[1:])), np.empty((levels + 2, len(margin)))
    q0, e0 = q[:, 0].copy(), ends[0].copy()
    g0 = measure_gaps(e0, *watch)
    least = np.minimum(margin, g0)
    lowest = least - slack
    row = _below(g0, least)
    if row >= 0:
        return row
    for point in range(1, q.shape[1]):
        top, depth[0] = 0, 0
        at[0], places[0] = q[:, point], ends[point]
        gaps[0] = measure_gaps(ends[point], *watch)
        row = _below(gaps[0], least)
        if row >= 0:
            return row
        while top >= 0:
            bulge = bound_bulges(at[top] - q0, *bounds)
            row = _unclear(e0, places[top], g0, gaps[top], bulge, lowest, *watch[:3])
            if row < 0:
                q0[:], e0[:], g0[:] = at[top], places[top], gaps[top]
                top -= 1
                continue
            if depth[top] == levels:
                return row
            depth[top] += 1
            depth[top + 1] = depth[top]
            at[top + 1] = 0.5 * (q0 + at[top])
            places[top + 1] = place_ends(at[top + 1].reshape(-1, 1), *chain)[0]
            top += 1
            gaps[top] = measure_gaps(places[top], *watch)
            row = _below(gaps[top], lowest)
            if row >= 0:
                return row
    return -1
