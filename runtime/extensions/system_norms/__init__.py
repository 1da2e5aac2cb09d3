"""System norms (H-infinity, H2), and the damping that a network adds at low frequency."""
