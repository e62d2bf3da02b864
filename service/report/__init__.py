"""The report on a fit as one page of HTML, which needs nothing else and may be saved or printed."""
