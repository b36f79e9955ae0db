"""The command line `giril`."""
