"""The command lines, thin: arguments -> configuration -> call.

serve       v2v-serve
worker      v2v-worker
simulate    v2v-simulate
preview     v2v-preview
catalogue   a corpus looked at ahead (v2v-catalogue)
prepare     v2v-prepare
tradeoff    speed against disk space, accuracy and diversity (v2v-tradeoff)
top         what a server is at, on a terminal (v2v-top)
doctor      what is in the way on this machine (v2v-doctor)
keys        who may talk to a server (v2v-keys)
quarantine  v2v-quarantine
spec_flags  the flags for what a stream is made of
"""
