"""Configuration: strict tables read from TOML, and the deployment file."""
