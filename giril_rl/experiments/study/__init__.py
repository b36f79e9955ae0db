"""Many runs from one file: a grid declared in YAML, checked as a whole, run several at a time."""
