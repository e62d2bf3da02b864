"""The page: a front end with its sources in `page/`, served as built files.

It gets all data from the API, as any other client does.
"""
