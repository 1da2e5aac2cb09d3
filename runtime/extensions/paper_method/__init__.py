"""The lifted matrices of Rakhsha and Constantinescu, eqs. (18) to (20)."""
