"""Many runs at a time, and their tables and figures."""
