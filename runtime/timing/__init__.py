"""Instants of events: clocks, schedules of a frame, the communication graph."""
