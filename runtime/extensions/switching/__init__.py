"""Contacts that switch arbitrarily (circle criterion), and limit cycles (describing function)."""
