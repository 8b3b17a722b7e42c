"""Which model of a library is it, and how must it be stretched?"""
