"""The independent engine: topologies followed event by event in balls, to fifty digits."""
