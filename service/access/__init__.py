"""Who may ask, and whom the service may call: tokens, OpenID Connect, addresses."""
