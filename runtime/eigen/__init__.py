"""All peers together: their modes, rigid motions and spectrum, with a bound for every error."""
