"""Lidars: one file a model, from packets to shots; and the corrections of single lasers."""
