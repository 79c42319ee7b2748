"""Links between hosts: keys, logins, and the access control that follows from the topic table."""
