"""Experiments: options, plan, summary and page text of each."""
