"""The AEPnP paper's simulation."""
