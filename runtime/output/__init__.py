"""The output of results: text, plain data, tables and pictures."""
