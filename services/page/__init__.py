"""The web page of a running system: status, images and map; commands for users with the token."""
