from e4 import *
task,c,frames,data=load("pendulum")
c=C(divergence_start=.03,state_weight=1.0)
m=phases(task,"alps",frames,data,c,[("warm",300,3,16,2e-3,2e-3),("warm",400,9,16,2e-3,3e-4)])
torch.save(m.state_dict(),"/tmp/exp-paper/pend5-warm.pt")
sd=m.state_dict()
m=phases(task,"alps",frames,data,c,[("est",300,33,64,2e-3,1e-4),("joint",200,33,16,1e-3,5e-4),("joint",200,99,16,5e-4,1e-5)],model=m,every=100)
torch.save(m.state_dict(),"/tmp/exp-paper/pend5.pt")
