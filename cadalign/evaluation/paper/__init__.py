"""The AEPnP paper's tables and figures."""
