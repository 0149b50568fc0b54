"""What the ports of several methods share."""
