"""Looks at trials while they run, ledgers of ideas, archives, and sites of them."""
