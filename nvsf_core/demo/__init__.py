"""The demo: an analytic street, exact everywhere, written as a drive."""
