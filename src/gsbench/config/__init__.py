"""The configuration: its schema, how it is composed, and the words of a command line."""
