"""Errors of methods on instances, their summaries, and the Cramer-Rao bound."""
