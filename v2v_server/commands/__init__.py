"""The command lines, thin: arguments -> configuration -> call.

serve       v2v-serve
worker      v2v-worker
simulate    v2v-simulate
preview     v2v-preview
catalogue   catalogue a corpus in advance (v2v-catalogue)
prepare     v2v-prepare
fit         a camera fitted to a recording (v2v-fit)
tradeoff    speed against disk space, accuracy and diversity (v2v-tradeoff)
top         the state of a server on a terminal (v2v-top)
doctor      check this machine and a corpus (v2v-doctor)
keys        manage the keys of a server (v2v-keys)
quarantine  v2v-quarantine
"""
