"""The paper's topology in numbers, computed apart from this project by brute-force propagation over one
frame.

Devices of 0.1 kg and copies of 0.2 kg, both damped by 5 N·s/m, forces every 1 ms, packets every 8 ms. Delayed
means by 1 ms for a force and by 8 ms for a packet. "AP" is coordination to the others' mean, "VC" virtual
coupling between every pair.
"""

from __future__ import annotations

OPERATORS = {"AP": "mean", "VC": "sum"}

# (scheme, peers, delayed, spectral radius of one frame without the common translation), at K_T = 800,
# B_T = 2, K_C = 1500, B_C = 2; right to 1e-8.
MIDPOINT_RADIUS = (
    ("AP", 3, True, 0.8982367557),
    ("VC", 3, True, 0.9121448917),
    ("AP", 5, False, 0.8513958715),
    ("VC", 5, False, 0.805679409),
)

# (delayed, which forces that is, B_T = B_C, K_C, largest stable K_T of AP, of VC) for three peers: the first
# crossing as K_T grows, right to 5e-4.
LIMITS = (
    (False, "all", 0, 100, 2127.449, 1063.725),
    (False, "all", 0, 2000, 2868.148, 1434.074),
    (False, "all", 2, 100, 4488.004, 2959.062),
    (False, "all", 2, 2000, 5869.746, 3479.811),
    (True, "all", 0, 100, 708.186, 354.093),
    (True, "all", 0, 1000, 1096.411, 548.205),
    (True, "all", 2, 100, 1493.128, 962.734),
    (True, "all", 2, 1000, 2477.935, 1378.111),
    (True, "own", 0, 100, 743.165, 371.582),
)

# (B_C, largest stable K_C) without coordination, the force delayed; right to 5e-4.
CONTACT_LIMITS = ((0, 1865.424), (2, 3175.018))

# (the packets' delay in ms, largest stable K_T of AP), B_T = B_C = 2, K_C = 2000, the forces delayed; right
# to 0.5: a delay that helps.
HELPED_LIMITS = ((0, 2602), (8, 3041))
