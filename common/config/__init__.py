"""Configuration: strictly validated TOML tables, and the deployment file."""
