"""Campaigns: thousands of damaged inputs, each of which is used or refused."""
