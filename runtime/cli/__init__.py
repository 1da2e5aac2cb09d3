"""What a person types: the commands, their options, what they read and write."""
