"""Running another program as a trainer: what it is given, how it is run and ended, what it leaves."""
