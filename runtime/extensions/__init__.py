"""Answers that few users need, each in a folder of its own (see `support.extension_table`)."""
