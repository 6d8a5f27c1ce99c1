"""The host's edge of the wire: packets, clock, links (serial, UDP), discovery."""
