"""The processes of ``fewview serve``: ``supervisor`` starts, watches and stops them."""
