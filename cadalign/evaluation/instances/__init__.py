"""Test instances with a known answer, and the records that a run keeps of them."""
