"""Against peers: commands that print ratios measured in one run."""
