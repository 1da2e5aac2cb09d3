"""CasADi functions of the equations, each computing only its required results."""
