"""Deployment files and the list of models, installed as package data."""
