"""Security of Zenoh links: host keys (mTLS), logins of local processes, and access control rules."""
