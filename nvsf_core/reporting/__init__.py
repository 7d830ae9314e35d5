"""Plots, previews and the offline HTML report."""
