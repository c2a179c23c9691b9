"""The command line: one command per file, each a function that typer reads options from."""
