"""The command lines, thin: arguments -> configuration -> call.

serve       v2v-serve
worker      v2v-worker
catalogue   catalogue a corpus in advance (v2v-catalogue)
prepare     v2v-prepare
top         the state of a server on a terminal (v2v-top)
keys        manage the keys of a server (v2v-keys)
quarantine  v2v-quarantine
"""
