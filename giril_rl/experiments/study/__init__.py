"""Many runs from one YAML file: checked as a whole, made several at a time."""
