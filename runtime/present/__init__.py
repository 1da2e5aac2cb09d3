"""What a person and a program see of results: text, plain data, tables and pictures."""
