// The form leads back to where the visitor wanted to go; who has a session already goes there at
// once (a browser withholds the cookie from a link on another site, but not from our own page).
const next = location.pathname === "/login" ? "/" : location.pathname;
document.getElementById("next").value = next;
document.getElementById("token").focus();
const answer = await fetch("/session").catch(() => null);
if (answer?.ok && (await answer.json()).let_in) location.replace(next);
