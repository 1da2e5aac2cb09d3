"""All peers: interconnection, deflation of rigid modes, eigenvalues with error bounds, determinants."""
