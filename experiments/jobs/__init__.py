"""Jobs that need nothing of each other, done side by side: on this machine's cores, or wherever a site says."""
