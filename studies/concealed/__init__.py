"""Concealed-effect study: own truth, own answers, own score.

Nothing here imports the package under test.  The tool is reached as a user reaches it: ``nlsid diagnose`` on a case folder.
"""
