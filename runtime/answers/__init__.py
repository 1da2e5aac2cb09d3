"""Everything `apc analyze` answers, put together and printed."""
