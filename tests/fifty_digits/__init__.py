"""The independent engine: scenes followed event by event in balls, to fifty digits."""
