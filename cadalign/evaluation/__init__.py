"""Evaluation: instances with a known answer, their errors, and tables of these."""
