"""Simulated problems: those of the AEPnP paper, and videos."""
