"""What other tools read: a judged scene as files of theirs."""
