"""Second moments of a loop whose packets get lost or come late by chance: stable in mean square?"""
