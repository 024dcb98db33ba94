"""`v2v-preview`: what a recipe makes of videos, as pictures.

command         the command line
preview         the pictures
"""
