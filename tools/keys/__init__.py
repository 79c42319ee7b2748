"""Key management: the certificate authority of a fleet, and the diagnosis of protected links."""
