"""The arithmetic of rooms on NumPy's arrays, which client and worker share.

It imports nothing else of the client, and neither owns it.
"""
