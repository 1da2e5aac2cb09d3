"""The largest numbers of states, by what is computed with them: one table.

Takes: nothing.
Gives: `MATRIX_STATES`, `PEER_STATES`, `SEARCH_STATES`, `BATCH_STATES`, `LURE_STATES`, `GAIN_BOUND_STATES`,
`LYAPUNOV_STATES`, `BALL_STATES`.
Guarantees: each limit has its reason and, where a test fixes it, the test.
Does not: count states.
"""

# One system: at a cost of n³, its eigenvalues would take minutes, and their error bounds would decide nothing
# (tests/language/test_limits.py).
MATRIX_STATES = 1000

# One peer, whose matrices store one rational per entry (tests/language/test_limits.py).
PEER_STATES = 1000

# One system over a range of values: at least a hundred matrices are stored at a time, with their
# eigenvectors. For 250 states a range takes ten seconds and half a GB (tests/language/test_limits.py).
SEARCH_STATES = 300

# One system whose matrices are shared by many points; larger systems are analyzed point by point.
BATCH_STATES = 120

# One loop with contacts that switch, and the ticks in contact: a Riccati equation of this size takes a
# second.
LURE_STATES = 150

# One loop with errors of received values: a Hamiltonian matrix of twice as many states takes a tenth of a
# second.
GAIN_BOUND_STATES = 120

# All peers and their channels in one matrix of a Monte Carlo run: ten equal peers
# (tests/networks/test_almost_sure.py).
LYAPUNOV_STATES = 180

# A reference in 512-bit balls: eigenvalues of larger matrices take minutes.
BALL_STATES = 110
