"""The socket: file server, keys, limits, and the advertisement on the network."""
