# Generated from _async by `generate`. Do not edit.
"""The synchronous client."""
