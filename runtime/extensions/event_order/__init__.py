"""The verdict under every order of simultaneous events."""
