"""The paper's protocol on real logs (section V-D): clips on a map, an adapted network, kidnappings, all methods."""
