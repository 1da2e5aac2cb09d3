"""CasADi to answers: linearize, schedule, lift, modes, spectrum."""
