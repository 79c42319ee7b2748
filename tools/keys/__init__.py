"""Key management: the certificate authority of a fleet, and the diagnosis of TLS links."""
