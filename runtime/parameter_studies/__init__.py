"""Analyses at many parameter values, and the values between them at which the verdict changes."""
