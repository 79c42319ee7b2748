"""A page for any browser: status, pictures and map, and commands for those with its token."""
