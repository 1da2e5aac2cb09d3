"""How much the tests protect: the product is changed in one place, and the tests that reach it run.

`python -m tests.mutants --count 300 --seed 1` draws such mutants, says of each whether a test failed,
and lists those that no test noticed. `sites` finds what may be
changed, `reach` notes which test runs which line.
"""
