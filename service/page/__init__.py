"""The page: a front end whose sources are in `page/`, served as the files that were built of it.

It shows what it asks of the API, as any other client does; nothing of it is stored here.
"""
